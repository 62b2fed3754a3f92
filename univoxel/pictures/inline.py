"""Pictures that stand in the text of a page."""

from __future__ import annotations

import base64
import html
import io

import numpy as np
from PIL import Image
from torch import Tensor

QUALITY = 85  # of JPEG


def inline(picture: Tensor, alt: str = "") -> str:
    """An <img> that holds a picture [h, w, 3] in [0, 1], sRGB."""
    encoded = io.BytesIO()
    values = (picture.clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8)
    Image.fromarray(values).save(encoded, format="JPEG", quality=QUALITY)
    data = base64.b64encode(encoded.getbuffer()).decode()
    return f'<img alt="{html.escape(alt)}" src="data:image/jpeg;base64,{data}">'
