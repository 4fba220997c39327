"""Online service provisioning in NFV-enabled networks: learn it with TorchRL, compare it with the classics.

Subpackages, each importing only from those above it: ``scenario`` (what the world is), ``simulator`` (how it moves),
``planners`` (the classics), ``env`` (TorchRL's view of it), ``networks``, ``losses``, ``training``, ``evaluation``.
"""

__version__ = "0.1.0"
