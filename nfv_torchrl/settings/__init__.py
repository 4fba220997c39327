"""What a setting may be: annotated types, one strict parser for scenarios and recipes, and a schema for each recipe.

Needs NumPy only, but for ``recipes`` and ``targets``.
"""
