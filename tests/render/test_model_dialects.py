"""One mesh as other programs write it: every dialect of OBJ and GLB reads as the same triangles."""

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from sceneprior.apps.retrieval.cad_models import read_glb, read_textured
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.furniture import read_obj
from sceneprior.render.model_files import joined, load_parts

DIALECTS = (
    "plain", "negative", "tabs", "indents", "continued", "crlf", "cr", "bom", "remarks", "all"
)  # fmt: skip


def two_boxes() -> list[trimesh.Trimesh]:
    seat, back = trimesh.creation.box((1, 0.5, 1)), trimesh.creation.box((1, 1, 0.1))
    back.apply_translation((0, 0.75, -0.45))
    return [seat, back]


def triangles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Corners of all triangles, in an order of their own."""
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)].round(3)
    return np.array(sorted(corners.reshape(len(corners), 9).tolist()))


WANTED = triangles(*(
    lambda whole: (whole.vertices, whole.faces)
)(trimesh.util.concatenate(two_boxes())))  # fmt: skip


def write_obj(path: Path, dialect: str) -> None:
    """Two groups, each with its own vertices before its faces, as most exporters write them."""
    has = {dialect} if dialect != "all" else set(DIALECTS)
    lines, before = [] if "bom" in has else ["# a chair", "mtllib chair.mtl"], 0
    for number, mesh in enumerate(two_boxes()):
        lines += ["v " + " ".join(f"{x:g}" for x in vertex) for vertex in mesh.vertices]
        lines += [f"o part{number}", f"g part{number}", "vn 0 1 0"]
        for face in mesh.faces:
            at = face - len(mesh.vertices) if "negative" in has else face + 1 + before
            corners = [f"{k}//{-1 if 'negative' in has else number + 1}" for k in at]
            gap = " \\ \n" if "continued" in has else " "
            lines.append(f"f {corners[0]} {corners[1]}{gap}{corners[2]}")
        before += len(mesh.vertices)
    if "remarks" in has:
        lines = [f"{line} # {line}" if line[0] in "vf" else line for line in lines]
    if "tabs" in has:
        lines = [line.replace(" ", "\t", 1) for line in lines]
    if "indents" in has:
        lines = ["  " + line for line in lines]
    end = "\r" if dialect == "cr" else "\r\n" if "crlf" in has else "\n"
    text = "\n".join(lines).replace("\n", end)
    path.write_bytes(text.encode("utf-8-sig" if "bom" in has else "utf-8"))


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_of_obj_is_the_same_mesh(tmp_path, dialect):
    path = tmp_path / "chair" / "raw_model.obj"
    path.parent.mkdir()
    write_obj(path, dialect)
    mesh = read_obj(path)
    np.testing.assert_allclose(triangles(mesh.vertices_m, mesh.faces), WANTED, atol=2e-3)
    whole = joined(load_parts(path).values())
    np.testing.assert_allclose(triangles(whole.vertices_m, whole.faces), WANTED, atol=2e-3)


def glb_of(kind: str, required: tuple[str, ...] = ()) -> bytes:
    """The boxes with positions as floats, or as normalized whole numbers in a node that scales."""
    whole = trimesh.util.concatenate(two_boxes())
    vertices, faces = whole.vertices.astype("<f4"), whole.faces.astype("<u2")
    node, accessor = {"mesh": 0}, {"componentType": 5126, "count": len(vertices), "type": "VEC3"}
    data = vertices.tobytes()
    if kind != "f4":
        node["scale"] = [2.0, 2.0, 2.0]
        most = np.iinfo(kind).max
        codes = np.round(vertices / 2 * most).astype(kind)
        wide = np.zeros((len(codes), 4), kind)  # rows begin at multiples of 4 bytes
        wide[:, :3] = codes
        data = wide.tobytes()
        accessor |= {"componentType": {"i2": 5122, "i1": 5120}[kind[-2:]], "normalized": True}
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": len(data)},
        {"buffer": 0, "byteOffset": len(data), "byteLength": faces.nbytes},
    ]
    if kind != "f4":
        views[0]["byteStride"] = wide.itemsize * 4
    accessors = [
        {"bufferView": 0, **accessor},
        {"bufferView": 1, "componentType": 5123, "count": faces.size, "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    content = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "scene": 0, "nodes": [node],
        "meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": len(data) + faces.nbytes}],
    }  # fmt: skip
    if required:
        content |= {"extensionsUsed": list(required), "extensionsRequired": list(required)}
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    packed = data + faces.tobytes()
    packed += bytes(-len(packed) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(packed), len(text), 0x4E4F534A)
    return head + text + struct.pack("<I4s", len(packed), b"BIN\0") + packed


@pytest.mark.parametrize("kind", ["f4", "<i2", "i1"])
def test_quantized_positions_are_the_same_mesh(tmp_path, kind):
    path = tmp_path / "chair.glb"
    path.write_bytes(glb_of(kind, () if kind == "f4" else ("KHR_mesh_quantization",)))
    mesh = read_glb(path)
    ours = triangles(mesh.vertices_m, mesh.faces).reshape(-1, 3)
    step = 2 / {"f4": 1e6, "<i2": 2**15, "i1": 2**7}[kind]
    wanted = WANTED.reshape(-1, 3)
    assert len(ours) == len(wanted)
    # Rounded corners may be sorted otherwise: each has one of the true corners nearby.
    apart = np.abs(ours[:, None] - wanted[None]).max(axis=2)
    assert apart.min(axis=1).max() <= step + 1e-3 and apart.min(axis=0).max() <= step + 1e-3


@pytest.mark.parametrize(
    "name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"]
)
def test_extensions_that_are_not_read_are_refused_by_name(tmp_path, name):
    path = tmp_path / "chair.glb"
    path.write_bytes(glb_of("f4", (name,)))
    with pytest.raises(InputError, match=rf"chair\.glb .*needs '{name}'.*plain GLB"):
        read_glb(path)


@pytest.mark.parametrize("image", ["PNG", "WEBP", "KTX2", "none"])
@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_a_texture_is_read_or_its_loss_is_said(tmp_path, suffix, image):
    packed = io.BytesIO(b"\xabKTX 20\xbb")
    if image in ("PNG", "WEBP"):
        Image.new("RGB", (9, 9), "red").save(packed, image)
    path = tmp_path / f"chair{suffix}"
    uv = "".join(f"vt {x} {y}\n" for x, y in ((0, 0), (1, 0), (1, 1)))
    text = f"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\n{uv}usemtl a\nf 1/1 2/2 3/3\n"
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd a.image\n")
    if suffix == ".glb":
        chair = trimesh.load_scene(io.BytesIO(text.encode()), "obj", process=False).to_mesh()
        material = PBRMaterial(baseColorTexture=Image.new("RGB", (9, 9)))
        chair.visual = TextureVisuals(uv=[[0, 0], [1, 0], [1, 1]], material=material)
        extra = {"images": [{"uri": "a.image"}]}
        path.write_bytes(with_json(trimesh.Scene(chair).export(file_type="glb"), extra))
    else:
        path.write_text(text)
    if image != "none":
        (tmp_path / "a.image").write_bytes(packed.getvalue())
    if image in ("PNG", "WEBP"):
        assert read_textured(path)[0].material.baseColorTexture.size == (9, 9)
        return
    with pytest.warns(InputWarning, match=r"colour of its class.*'a\.image' is missing, or no PNG"):
        assert read_textured(path) == ()


def with_json(glb: bytes, extra: dict) -> bytes:
    """A GLB with other entries in its JSON."""
    length = struct.unpack_from("<I", glb, 12)[0]
    text = json.dumps(json.loads(glb[20 : 20 + length]) | extra).encode()
    text += b" " * (-len(text) % 4)
    rest = glb[20 + length :]
    head = (b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return struct.pack("<4sIIII", *head) + text + rest


def test_an_image_within_a_glb_that_cannot_be_decoded_is_said(tmp_path):
    box = trimesh.creation.box()
    material = PBRMaterial(baseColorTexture=Image.new("RGB", (9, 9)))
    box.visual = TextureVisuals(uv=np.zeros((8, 2)), material=material)
    path, glb = tmp_path / "box.glb", trimesh.Scene(box).export(file_type="glb")
    path.write_bytes(glb.replace(b"\x89PNG\r\n", b"\xabKTX 2"))
    with pytest.warns(InputWarning, match="type 'image/png' cannot be decoded; export"):
        assert read_textured(path) == ()
    ktx2 = {"textures": [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]}
    path.write_bytes(with_json(glb, ktx2))
    with pytest.warns(InputWarning, match="'KHR_texture_basisu' cannot be decoded; export"):
        assert read_textured(path) == ()
    assert len(read_glb(path).faces) == 12
