"""Array aliases. Shapes are (row, col) for pictures and (col, row) for pixel coordinates.

========== =========== =====================================================
alias      shape       meaning
========== =========== =====================================================
Image      rows, cols  float32 picture
Mask       rows, cols  bool picture
Points     n, 3        float64, millimetres, patient LPS, origin at isocentre
Pixels     n, 2        float64, (col, row), pixel centres are integers
Scalars    n           float64
Volume     nx, ny, nz  float32, array index = (x, y, z) of the grid
========== =========== =====================================================
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Image: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.bool_]
Points: TypeAlias = NDArray[np.float64]
Pixels: TypeAlias = NDArray[np.float64]
Scalars: TypeAlias = NDArray[np.float64]
Volume: TypeAlias = NDArray[np.float32]
Array: TypeAlias = NDArray[Any]
