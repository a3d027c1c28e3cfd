"""Makes bench/ importable: it lies beside the package in a checkout and is not part of the wheel."""

from __future__ import annotations

import sys
from pathlib import Path

from ..errors import UsageError

PACKAGE = Path(__file__).resolve().parent.parent


def require_bench() -> None:
    """Adds the root of the checkout to sys.path, so that `import bench` finds its benchmarks.

    Raises:
        UsageError: gscodec is not installed from a checkout.
    """
    root = PACKAGE.parent
    if not (root / "bench" / "run.py").is_file():
        raise UsageError(
            f"the benchmarks are not part of an installed wheel, and {root / 'bench'} does not exist; "
            "clone the repository and install from there: pip install --editable '.[encode,charts,bench]'"
        )
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
