"""How good a method is: the record of a run, its metrics, their statistics, tables and figures, and the audit."""
