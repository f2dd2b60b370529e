"""CUDA graphs: functions whose launches are captured once and then replayed together, and values
that are copied to the host while the GPU goes on."""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from sceneprior.core.errors import InputWarning, cause_of

Function = Callable[..., Any]


class Captured:
    """A function of tensors that, once `capture` was called, replays the work on the GPU.

    The tensors must then have the shapes of those given to `capture`, and the results are
    overwritten by the next call; a module's weights must stay where they are in memory. A step of
    the paper's network launches 2,000 kernels of 2 microseconds, and Python takes 20 for each; a
    graph launches all of them at once.
    """

    def __init__(self, name: str, function: Function):
        self.name, self.function, self._weights = name, function, list[Tensor]()
        if isinstance(function, nn.Module):
            self._weights = [*function.parameters()]
            names = [name for name, _ in function.named_parameters()]
            self.function = partial(_with_weights, function, names)

    def __call__(self, *tensors: Tensor) -> Any:
        return self.function(*tensors, *self._weights)

    def capture(self, *tensors: Tensor) -> None:
        """Capture the function with tensors like these; if that fails, warn and keep the function
        as it is."""
        samples = tuple(
            tensor.detach().clone().requires_grad_(tensor.requires_grad) for tensor in tensors
        )
        # Weights are captured through other leaves that share their memory: theirs may belong to
        # a graph of this step, on the stream of training, with which no capture may be mixed.
        samples += tuple(
            weight.detach().requires_grad_(weight.requires_grad) for weight in self._weights
        )
        try:
            self.function = captured(self.function, samples)
        except Exception as error:  # torch raises RuntimeError and others; training goes on
            warnings.warn(
                f"No CUDA graph of {self.name} ({type(error).__name__}: {cause_of(error)}); "
                "training goes on without it, more slowly.",
                InputWarning,
                stacklevel=2,
            )


def _with_weights(module: nn.Module, names: list[str], *tensors: Tensor) -> Any:
    """A module's results, its weights given after its inputs."""
    inputs, weights = tensors[: -len(names)], tensors[-len(names) :]
    return functional_call(module, dict(zip(names, weights, strict=True)), inputs)


def captured(function: Function, samples: tuple[Tensor, ...]) -> Function:
    """The function as CUDA graphs, of its forward and its backward pass.

    Random numbers drawn while capturing leave the generator as it was. Each replay draws by the
    generator's seed and offset then, as the function itself would.
    """
    device = samples[0].device
    stream, state = torch.cuda.current_stream(device), torch.cuda.get_rng_state(device)
    # Weights that autocast has converted would be read from its cache, and never again converted.
    precision = torch.get_autocast_dtype("cuda"), torch.is_autocast_enabled("cuda")
    try:
        with torch.autocast("cuda", *precision, cache_enabled=False), warnings.catch_warnings():
            # The step that is under way keeps nodes of its own stream; samples have others.
            warnings.filterwarnings("ignore", "The AccumulateGrad node's stream")
            return torch.cuda.make_graphed_callables(function, samples, allow_unused_input=True)
    except Exception:
        # A capture that fails leaves its stream current, and the generator unusable.
        torch.cuda.set_stream(stream)
        generator = torch.cuda.default_generators[torch.cuda.current_device()]
        generator.graphsafe_set_state(torch.Generator(device))
        raise
    finally:
        torch.cuda.set_rng_state(state, device)


class OnHost:
    """Copies of tensors on the host, made while the GPU goes on with what it is given next."""

    def __init__(self, *tensors: Tensor):
        self._copies = [
            torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=tensor.is_cuda).copy_(
                tensor.detach(), non_blocking=True
            )
            for tensor in tensors
        ]
        self._done = None
        if tensors[0].is_cuda:
            self._done = torch.cuda.Event()
            self._done.record()

    def read(self) -> list[Tensor]:
        """Wait for the copies, and return them."""
        if self._done is not None:
            self._done.synchronize()
        return self._copies
