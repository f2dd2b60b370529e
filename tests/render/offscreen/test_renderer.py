"""Both renderers: ids by hand, agreement, and errors on machines without GL."""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest
from refusals import refused

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.cameras import Orthographic, Pinhole
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh
from sceneprior.render import offscreen
from sceneprior.render.appearance import box_mesh
from sceneprior.render.offscreen import gl, open_renderer

INTRINSICS = np.array([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]])
SIZE = (96, 128)


def box(center, size, inside_out=False):
    mesh = box_mesh([*map(float, center)], [*map(float, size)])
    return Mesh(mesh.vertices_m, mesh.faces[:, ::-1]) if inside_out else mesh


@pytest.fixture(params=["software", "pyrender"])
def renderer(request):
    if request.param == "pyrender":
        try:
            return open_renderer("pyrender")
        except InputError as error:
            pytest.skip(str(error))
    return open_renderer("software")


def bounds(mask):
    rows, columns = np.nonzero(mask)
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def test_a_unit_box_covers_exactly_its_projection(renderer):
    # The near side lies at z = 4.5: x from -0.25 to 0.75 is u from 58.44 to 80.67, of which the
    # centres of columns 58 to 79 are inside; y from -0.5 to 0.5 is v from 36.89 to 59.11.
    ids = renderer.instance_ids(
        [box((0.25, 0, 5), (1, 1, 1))], Pinhole(np.eye(4), INTRINSICS), SIZE
    )
    assert ids.dtype == np.uint16 and ids.shape == SIZE
    assert bounds(ids == 1) == (58, 37, 80 + 1, 59)
    assert (ids[37:59, 58:81] == 1).all()


def test_equally_near_faces_go_to_the_first_mesh(renderer):
    wall = box((0, 0, 3), (9, 9, 0.1))
    ids = renderer.instance_ids([wall, wall], Pinhole(np.eye(4), INTRINSICS), SIZE)
    assert (ids == 1).all()


def test_many_ids_and_empty_meshes(renderer):
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    meshes = [empty] * 699 + [box((0, 0, 3), (1, 1, 1)), empty]
    ids = renderer.instance_ids(meshes, Pinhole(np.eye(4), INTRINSICS), SIZE)
    assert set(np.unique(ids)) == {0, 700}
    nothing = renderer.instance_ids_of_views([], [Pinhole(np.eye(4), INTRINSICS)] * 2, SIZE)
    assert nothing.shape == (2, *SIZE) and not nothing.any()


def test_renderers_agree():
    try:
        ours, theirs = open_renderer("software"), open_renderer("pyrender")
    except InputError as error:
        pytest.skip(str(error))
    rng = np.random.default_rng(5)
    meshes = [
        box(rng.uniform((-2, -1, 1), (2, 1, 5)), rng.uniform(0.1, 1.5, 3), inside_out=k % 2 == 0)
        for k in range(30)
    ]
    K = np.array([[240.0, 0, 240], [0, 240, 180], [0, 0, 1]])
    cameras: list[offscreen.Camera] = []
    for angle in np.linspace(0, 6, 7):
        turn = np.eye(4)
        turn[:3, :3] = yaw_rotation(angle)
        cameras.append(Pinhole(turn, K))
    cameras.append(Orthographic(np.eye(4), 0.01))
    one = ours.instance_ids_of_views(meshes, cameras, (360, 480))
    other = theirs.instance_ids_of_views(meshes, cameras, (360, 480))
    agreement = (one == other).mean(axis=(1, 2))
    assert agreement.min() >= 0.999, agreement


def no_gl(monkeypatch):
    def missing():
        raise gl.NoGLError("libEGL or libGL is not installed")

    monkeypatch.setattr(gl, "_probe_gl", missing)
    monkeypatch.setattr(gl, "_pyrender", None)
    monkeypatch.setattr(gl, "_failure", None)
    monkeypatch.delenv(offscreen.ENVIRONMENT_VARIABLE, raising=False)
    offscreen._notice.cache_clear()


def test_without_gl_auto_says_so_once_and_draws(monkeypatch, capsys):
    no_gl(monkeypatch)
    assert open_renderer("auto").name == "software"
    assert open_renderer("auto").kind == "software"
    notice = capsys.readouterr().err
    assert notice.count("\n") == 1
    assert "software z-buffer" in notice and offscreen.APT_LINE in notice


def test_what_cannot_be_opened_is_one_sentence(monkeypatch):
    with refused("render/unknown renderer"):
        open_renderer("opengl")
    no_gl(monkeypatch)
    with refused("render/pyrender without GL"):
        open_renderer("pyrender")
    no_gl(monkeypatch)
    monkeypatch.setattr(gl, "_probe_gl", lambda: "egl")
    monkeypatch.setattr(gl, "_PyrenderRenderer", lambda: [].context)
    with refused("render/pyrender without a context"):
        open_renderer("pyrender")


def test_one_pyrender_a_process_and_none_after_a_fork():
    try:
        one = open_renderer("pyrender")
    except InputError as error:
        pytest.skip(str(error))
    assert open_renderer("pyrender") is one
    code = (
        "import os, numpy as np\n"
        "from sceneprior.core.cameras import Pinhole\n"
        "from sceneprior.render.offscreen import open_renderer\n"
        "r = open_renderer('pyrender')\n"
        "if os.fork() == 0:\n"
        "    try:\n"
        "        r.instance_ids([], Pinhole(np.eye(4), np.eye(3)), (4, 4))\n"
        "    except RuntimeError as error:\n"
        "        os._exit(0 if 'spawn' in str(error) else 1)\n"
        "    os._exit(2)\n"
        "raise SystemExit(os.waitstatus_to_exitcode(os.wait()[1]))\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_drawing_needs_neither_torch_nor_a_window_and_lets_triton_load():
    """Lightning imports Triton where it is installed; after Mesa's LLVM that was a segfault."""
    code = (
        "import sys, data_prep.engine.build, sceneprior.render.offscreen as o\n"
        "o.open_renderer('auto')\n"
        "print([m for m in ('torch', 'pyglet') if m in sys.modules])\n"
    )
    if importlib.util.find_spec("triton") is not None:
        code += "import triton\n"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (run.returncode, run.stdout.strip()) == (0, "[]"), run.stderr
