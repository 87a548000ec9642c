"""From a folder of scans to a trajectory and a map: ``python -m train map SCANS --out OUT``."""

import warnings

# Lightning asks torch for a tree class that torch 2.13 renames; nothing a user of the mapper could do about it.
warnings.filterwarnings("ignore", message=".*LeafSpec.*")
