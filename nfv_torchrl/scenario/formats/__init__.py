"""Formats of other projects' network files, and what files of all formats become: ``GraphFile``, ``DemandMatrix``."""
