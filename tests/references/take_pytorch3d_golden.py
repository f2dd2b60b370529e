"""Write tests/golden/pytorch3d_silhouettes.npz: a part of what PyTorch3D drew for us.

    cd tests && python -m references.take_pytorch3d_golden

Two of the four views at 90 x 120, one of them with an object around the camera. The whole,
shared/data/oracle_silhouettes.npz, says in its array `README` what each array is.
"""

from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
WHOLE = ROOT.parent / "shared" / "data" / "oracle_silhouettes.npz"
GOLDEN = ROOT / "tests" / "golden" / "pytorch3d_silhouettes.npz"
TAG, VIEWS = "90x120", [0, 3]
EVERY_VIEW = ("README", "verts", "faces", "sigma", "blur_radius_A", "blur_radius_B", f"K_{TAG}")
BY_VIEW = ("R", "t", f"scene_alpha_B_{TAG}", f"scene_grad_B_{TAG}", f"scene_id_hard_{TAG}",
           f"scene_depth_hard_{TAG}")  # fmt: skip
BY_OBJECT_AND_VIEW = ("z_min", f"weights_int8_{TAG}", f"alpha_nocap_A_{TAG}",
                      f"grad_nocap_A_{TAG}", f"alpha_B_{TAG}", f"grad_B_{TAG}", f"k_full_B_{TAG}",
                      f"mask_hard_{TAG}")  # fmt: skip


def main() -> None:
    with np.load(WHOLE) as whole:
        arrays = {name: whole[name] for name in EVERY_VIEW}
        arrays |= {name: whole[name][VIEWS] for name in BY_VIEW}
        arrays |= {name: whole[name][:, VIEWS] for name in BY_OBJECT_AND_VIEW}
    np.savez_compressed(GOLDEN, **arrays)
    print(f"{GOLDEN}: {GOLDEN.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
