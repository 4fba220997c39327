"""What recipes share: exploration schedules, checkpoints, logging and seeds. The loops are in ``recipes/``."""
