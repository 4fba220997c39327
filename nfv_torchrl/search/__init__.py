"""Searches over the walks of a request: exact by labels, along simple paths, and the graph of an integer programme."""
