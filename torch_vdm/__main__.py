"""``python -m torch_vdm``, the same as ``torch-vdm``."""

import sys

from torch_vdm.cli import main

sys.exit(main())
