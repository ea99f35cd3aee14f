"""Scripts; ``python -m examples.safetac_point`` finds what they share as ``python`` does."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
