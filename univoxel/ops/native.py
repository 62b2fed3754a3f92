"""The door to the compiled kernels: which build is loaded, when it serves, on how many threads.

Nothing outside ``univoxel.ops`` imports the extension.
"""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import torch  # first: the extension then shares torch's OpenMP runtime
from torch import Tensor

from univoxel.errors import MissingNative

Backend = Literal["auto", "native", "reference"]

_backend: Backend = "auto"


def _load() -> tuple[ModuleType | None, str]:
    """The build for this processor, or None and the reason why there is none."""
    folder = Path(__file__).parent.parent / "_core"
    built = {p.parent.name: p for p in folder.glob("*/_core.*") if p.suffix in (".so", ".pyd")}
    capability = torch.backends.cpu.get_cpu_capability().lower()
    rank = ["default", "avx2", "avx512"]
    usable = rank[: rank.index(capability) + 1] if capability in rank else ["default"]
    for variant in reversed(usable):
        if variant not in built:
            continue
        spec = importlib.util.spec_from_file_location("univoxel._core", built[variant])
        assert spec is not None
        assert spec.loader is not None
        try:
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
        except ImportError as error:
            return None, f"{built[variant].name} ({variant}): {error}"
        sys.modules["univoxel._core"] = module
        return module, variant
    return None, f"no extension built under {folder}"


core, variant = _load()


def serves(tensor: Tensor) -> bool:
    """Whether the native kernels take this tensor: on the CPU, float32 or float64.

    Raises:
        RuntimeError: the native backend is forced and cannot serve.
    """
    if _backend == "reference":
        return False
    fits = tensor.device.type == "cpu" and tensor.dtype in (torch.float32, torch.float64)
    if _backend == "native" and not fits:
        raise RuntimeError(
            f"the native backend serves float32 and float64 on the cpu, got {tensor.dtype} on "
            f"{tensor.device}"
        )
    return core is not None and fits


def reference_asked() -> bool:
    """Whether the reference is forced; for ops too slow in eager torch to fall back unasked."""
    return _backend == "reference"


@contextlib.contextmanager
def use_backend(name: Backend) -> Iterator[None]:
    """Force a side within a ``with`` block: "native", "reference", or "auto" (the default).

    Raises:
        ValueError: an unknown name.
        RuntimeError: "native" without a loaded extension; the message says why it is missing.
    """
    global _backend
    if name not in ("auto", "native", "reference"):
        raise ValueError(f"use_backend: name must be auto, native or reference, got {name!r}")
    if name == "native":
        require()
    before, _backend = _backend, name
    try:
        yield
    finally:
        _backend = before


def require() -> ModuleType:
    """The extension, or an error that says why it is missing."""
    if core is None:
        raise MissingNative(f"univoxel's compiled extension is not loaded: {variant}")
    return core


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """NumPy views of tensors, as the extension takes them."""
    return [t.detach().numpy() for t in tensors]


def threads() -> int:
    """torch.set_num_threads rules the kernels too."""
    return torch.get_num_threads()


def operator(name: str, mutates_args: tuple[str, ...] = ()) -> Callable[[Callable], Any]:
    """``torch.library.custom_op`` of a kernel for the CPU.

    Kernels that custom_op registers itself import the compiler when first called: a second, and
    70 MB, of every command.
    """

    def define(kernel: Callable) -> Any:
        qualified = f"univoxel::{name}"
        defined = torch.library.custom_op(
            qualified, kernel, mutates_args=mutates_args, device_types=()
        )
        torch.library.impl(qualified, "cpu", kernel)
        return defined

    return define
