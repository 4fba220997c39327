"""A method without its shortcuts, which a runner then asks for every single step."""

from __future__ import annotations


class StepByStep:
    """``act`` of a method, and nothing of what it can do in one call."""

    def __init__(self, method):
        self.name, self.mask, self.one_hot = method.name, method.mask, method.one_hot
        self.decides_admission, self.prepare, self.act = method.decides_admission, method.prepare, method.act
