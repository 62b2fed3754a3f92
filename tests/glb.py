"""GLB files as an independent reader has them."""

import io
import warnings

import numpy as np
from PIL import Image

KINDS = {5126: "<f4", 5125: "<u4", 5122: "<i2"}  # of components, by glTF's numbers


class Glb:
    """A file with one mesh, or its bytes."""

    def __init__(self, content):
        from pygltflib import GLTF2

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            read = GLTF2.load_from_bytes if isinstance(content, bytes) else GLTF2().load
            self.file = read(content if isinstance(content, bytes) else str(content))
        (self.primitive,) = self.file.meshes[0].primitives

    def data(self, view):
        """Bytes of a buffer view by its number."""
        part = self.file.bufferViews[view]
        assert part.byteOffset % 4 == 0
        return self.file.binary_blob()[part.byteOffset :][: part.byteLength]

    def accessor(self, name):
        """What the mesh's attribute of a name is."""
        return self.file.accessors[getattr(self.primitive.attributes, name)]

    def values(self, name):
        """Of the mesh's attribute of a name, [vertices, ...], or of its faces [F, 3]."""
        if name == "faces":
            found, count = self.file.accessors[self.primitive.indices], -1
        else:
            found, count = self.accessor(name), self.accessor(name).count
        values = np.frombuffer(self.data(found.bufferView), KINDS[found.componentType])
        return values.reshape(-1, 3) if count == -1 else values.reshape(count, -1)

    def pictures(self):
        """Textures: type, size in bytes and pixels of each."""
        found = []
        for image in self.file.images:
            data = self.data(image.bufferView)
            opened = Image.open(io.BytesIO(data))
            assert opened.format == {"image/png": "PNG", "image/jpeg": "JPEG"}[image.mimeType]
            found.append((image.mimeType, len(data), np.asarray(opened.convert("RGB"), float)))
        return found
