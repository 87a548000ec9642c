"""Other people's ways from scans to poses, each in a file: the rivals of ``benchmarks/mapping_rivals.py``.

All lengths in the settings are shares of the scans' ``reach``, so that a sequence's own unit plays no part.
"""
