"""What all tests run in."""

import os
import tempfile
from pathlib import Path

import torch

# Kernels that torch.compile has compiled for another instruction set are wrong here, not only slow:
# its cache, in one folder for all processes of a user, does not tell them apart.
_KIND = f"{torch.__version__}-{torch.backends.cpu.get_cpu_capability()}"
_FOLDER = Path(tempfile.gettempdir()) / f"univoxel-tests-inductor-{os.getuid()}-{_KIND}"
os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(_FOLDER))
