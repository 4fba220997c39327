"""Checkers for what users write: call one in a test of your own package.

Each raises ``AssertionError`` with one line that says what is wrong::

    from nfv_torchrl.testing import check_loss

    def test_my_loss():
        check_loss(MyLoss)

``check_loss``, ``check_planner``, ``check_observation`` and ``check_reward`` need nothing but the thing to be checked;
they bring small networks and requests of their own and take some seconds.
"""

from nfv_torchrl.testing.loss import check_loss
from nfv_torchrl.testing.observation import check_observation
from nfv_torchrl.testing.planner import check_planner
from nfv_torchrl.testing.reward import check_reward

__all__ = ["check_loss", "check_observation", "check_planner", "check_reward"]
