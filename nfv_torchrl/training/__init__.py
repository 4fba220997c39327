"""What recipes share: exploration schedules, checkpoints, logging, seeds. The loops themselves are in ``recipes/``."""
