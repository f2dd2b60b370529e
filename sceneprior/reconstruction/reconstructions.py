"""Reconstructions to files: a scene's JSON and GLB, and a picture beside the masks, each."""

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

from PIL import Image

from sceneprior.files import write_whole
from sceneprior.generation.export import clear_scenes, write_scene
from sceneprior.offscreen import Renderer
from sceneprior.reconstruction.pictures import picture
from sceneprior.reconstruction.reconstruct import Reconstruction


def write_reconstructions(
    found: Sequence[Reconstruction], folder: Path, renderer: Renderer
) -> None:
    """Write `<name>.json`, `.glb` and `.png`, and `<name>_seen.png`, for each image.

    The JSON's `extra` says where the image is from, its camera, and how well its masks are met.
    """
    clear_scenes(folder)
    for one in found:
        image = one.image
        extra = {
            "room_id": image.room_id,
            "view": image.view,
            "world_to_camera": image.world_to_camera.tolist(),
            "intrinsics": image.intrinsics.tolist(),
            "image_size": list(image.instance_ids.shape),
            "score": round(one.score, 5),
            "mask_iou": round(one.mask_iou, 4),
            "steps": one.steps,
        }
        scene = replace(one.scene, extra=extra)
        with BytesIO() as file:
            Image.fromarray(picture(one, renderer)).save(file, format="PNG")
            write_whole(Path(folder) / f"{image.name}_seen.png", file.getvalue())
        write_scene(scene, folder, image.name, renderer)
