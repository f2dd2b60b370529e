"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

RendererOption = Annotated[
    str, typer.Option(help="auto, pyrender or software (needs no GL library).")
]
RunOption = Annotated[Path, typer.Option(help="Folder of a run that `fit` made.")]
DistributionOption = Annotated[
    str | None,
    typer.Option(help="sampler, kernel, geodesic, gaussian or paper (default: the config's)."),
]
CheckpointOption = Annotated[
    str,
    typer.Option(help="final, or best: what generated best while training (samples.every)."),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
InceptionOption = Annotated[
    Path | None, typer.Option(help="inception-2015-12-05.pt (TorchScript), for FID proper.")
]
AcceleratorOption = Annotated[str, typer.Option(help="cpu, gpu or auto; Lightning's option.")]
