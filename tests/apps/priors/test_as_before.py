"""Packed priors hold the same bytes as before, and shipped ones the same weights."""

import hashlib
import zipfile

import pytest
import torch
from golden_values import assert_as_before
from tiny_runs import tiny_config

from sceneprior.apps.config import load_any_run
from sceneprior.apps.priors.packed import FILES, pack, read_packed, shipped_priors, write_packed


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


@pytest.mark.parametrize("options", [{}, {"latents": True}], ids=str)
def test_a_packed_file_has_the_same_bytes(tmp_path, options):
    """Weights are counted up, so that they do not depend on a processor."""
    config = tiny_config("some/shards").with_label_set()
    networks = config.networks("shape", 3)
    for number, tensor in enumerate(networks.state_dict().values()):
        values = torch.arange(tensor.numel()).reshape(tensor.shape) % 97 / 8 + number
        tensor.copy_(values.to(tensor.dtype))
    trained = config.trained(networks, "shape", ("a", "b", "c"))
    write_packed(pack(trained, "# a card", **options), tmp_path / "a.prior")
    with zipfile.ZipFile(tmp_path / "a.prior") as archive:
        found = {name: digest(archive.read(name)) for name in archive.namelist()}
    assert tuple(found) == FILES
    assert_as_before(f"apps/packed_{'_'.join(options) or 'plain'}", found)


def test_shipped_priors_hold_the_same_weights():
    """Whatever the names of tensors, which may change."""
    found = {}
    for name, path in shipped_priors().items():
        trained, said = load_any_run(name), read_packed(path).said
        networks = {"prior": trained.prior, "sampler": trained.sampler}
        tensors = [t for n in networks.values() for t in n.state_dict().values()]
        hashes = sorted(
            digest(t.contiguous().numpy().tobytes()) for t in [*tensors, trained.logits]
        )
        found[name] = [trained.stage, said.training_rooms, len(said.room_ids), len(hashes),
                       digest("".join(hashes).encode())]  # fmt: skip
    assert_as_before("apps/shipped_weights", found)
