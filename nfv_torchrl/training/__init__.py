"""What recipes share: command lines, schedules, checkpoints, logging."""
