"""The learning rate of a recipe."""

from types import SimpleNamespace

import pytest
import torch

from nfv_torchrl.training.learner import falling_rate


@pytest.mark.parametrize(
    ("end", "done", "rate"), [(0.02, 0.0, 0.1), (0.02, 0.5, 0.06), (0.02, 1.5, 0.02), (None, 0.5, 0.1)]
)
def test_it_falls_on_a_straight_line_and_is_back_afterwards(end, done, rate):
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=0.1)
    with falling_rate(optimizer, SimpleNamespace(lr=0.1, lr_end=end), done):
        assert optimizer.param_groups[0]["lr"] == pytest.approx(rate)
    assert optimizer.param_groups[0]["lr"] == 0.1  # what a checkpoint says
