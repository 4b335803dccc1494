"""Scene for 3D Slicer (MRML): volume, surface and centreline of a result folder, with colours.

The scene names the files of the folder and holds none of them. Slicer turns LPS into its own RAS by
the coordinate system that stands with each file.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

#: without a revision Slicer takes a scene for an old one, whose meshes were RAS
_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<MRML version="Slicer 5.8.1 33241" userTags="">\n'
#: what the three files are drawn as; ids are those that Slicer itself would give
_GREY = "vtkMRMLColorTableNodeGrey"
#: a colour of its own for every whole number: the branches
_BY_NUMBER = "vtkMRMLProceduralColorNodeRandomIntegers"

#: what a scene names of the folder
FILES = VOLUME, SURFACE, CENTERLINE = "volume.nii.gz", "surface.stl", "centerline.vtp"
#: signs of a file name that Slicer decodes, and no others
_ENCODED = str.maketrans({sign: f"%{ord(sign):02X}" for sign in " %'\"<>"})


def slicer_scene(folder: Path, scene: Path) -> str:
    """Return the text of a scene.

    Parameters
    ----------
    folder : result folder
    scene : where the text will be kept: file names are told from there
    """
    parts = [
        _node("VolumeDisplay", "vtkMRMLScalarVolumeDisplayNode1", "volume display", {
            "colorNodeID": _GREY, "window": "1", "level": "0.5", "autoWindowLevel": "0",
            "interpolate": "1", "visibility": "true",
        }),
        _stored("VolumeArchetypeStorage", 1, folder / VOLUME, scene,
                {"UseOrientationFromFile": "1"}),
        _node("Volume", "vtkMRMLScalarVolumeNode1", f"{folder.name} occupancy", {
            "references": "display:vtkMRMLScalarVolumeDisplayNode1;"
                          "storage:vtkMRMLVolumeArchetypeStorageNode1;",
        }),
        *_model(1, folder / SURFACE, scene, f"{folder.name} lumen", {
            "color": "0.84 0.37 0", "opacity": "0.45", "visibility2D": "true",
            "scalarVisibility": "false",
        }),
        *_model(2, folder / CENTERLINE, scene, f"{folder.name} centreline", {
            "color": "1 1 1", "opacity": "1", "lineWidth": "4", "scalarVisibility": "true",
            "activeScalarName": "BranchId", "activeAttributeLocation": "cell",
            "scalarRangeFlag": "UseColorNode", "colorNodeID": _BY_NUMBER,
        }),
    ]  # fmt: skip
    return _HEAD + "\n".join(parts) + "\n</MRML>\n"


def _model(
    number: int, file: Path, scene: Path, name: str, look: Mapping[str, str]
) -> tuple[str, str, str]:
    """Display, storage and model."""
    display = f"vtkMRMLModelDisplayNode{number}"
    return (
        _node("ModelDisplay", display, f"{name} display", {"visibility": "true", **look}),
        _stored("ModelStorage", number, file, scene, {"coordinateSystem": "LPS"}),
        _node("Model", f"vtkMRMLModelNode{number}", name, {
            "references": f"display:{display};storage:vtkMRMLModelStorageNode{number};",
        }),
    )  # fmt: skip


def _stored(kind: str, number: int, file: Path, scene: Path, more: Mapping[str, str]) -> str:
    relative = os.path.relpath(file, scene.parent).replace(os.sep, "/")
    told = {"fileName": relative.translate(_ENCODED), "useCompression": "1", **more}
    return _node(kind, f"vtkMRML{kind}Node{number}", file.name, told)


def _node(kind: str, own_id: str, name: str, told: Mapping[str, str]) -> str:
    pairs = {"id": own_id, "name": name, **told}
    written = " ".join(f"{key}={quoteattr(value)}" for key, value in pairs.items())
    return f" <{kind} {written}></{kind}>"
