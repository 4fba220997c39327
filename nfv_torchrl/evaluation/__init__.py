"""Evaluation: the record of a run, its metrics, their statistics, tables and figures, and the audit."""
