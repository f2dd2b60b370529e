"""GLBs in tests: their JSON and their images, and what the validator of Khronos says of them."""

import io
import json
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

_VALIDATE = """
const validator = require("gltf-validator");
const bytes = new Uint8Array(require("fs").readFileSync(process.argv[1]));
validator.validateBytes(bytes).then(report => console.log(JSON.stringify(report.issues)));
"""


def validate(path: Path) -> None:
    """Fail on errors or warnings of npm's gltf-validator; skip the test where it is not installed:
    `npm install gltf-validator`, and NODE_PATH names node_modules."""
    known = shutil.which("node") and subprocess.run(
        ["node", "-e", "require('gltf-validator')"], capture_output=True
    )
    if not known or known.returncode:
        pytest.skip("no gltf-validator here: npm install gltf-validator, and set NODE_PATH")
    command = ["node", "-e", _VALIDATE, str(path)]
    issues = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def json_of(glb: bytes) -> dict[str, Any]:
    """The JSON chunk of a GLB."""
    (length,) = struct.unpack("<I", glb[12:16])
    return json.loads(glb[20 : 20 + length])


def images_of(glb: bytes) -> list[Image.Image]:
    """The images in a GLB."""
    told = json_of(glb)
    (length,) = struct.unpack("<I", glb[12:16])
    data = glb[20 + length + 8 :]
    views = [told["bufferViews"][image["bufferView"]] for image in told.get("images", [])]
    starts = [view.get("byteOffset", 0) for view in views]
    return [
        Image.open(io.BytesIO(data[start : start + view["byteLength"]]))
        for start, view in zip(starts, views, strict=True)
    ]
