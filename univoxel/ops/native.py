"""Loading of the compiled kernels: which build is used, for which tensors, on how many threads.

Nothing outside ``univoxel.ops`` imports the extension.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import torch  # first: the extension then shares torch's OpenMP runtime
from torch import Tensor

from univoxel.core import log
from univoxel.errors import MissingNative

Backend = Literal["auto", "native", "reference"]
FOLDER = Path(__file__).parent.parent / "_core"
PLAIN: set[type[Any]] = {
    Tensor,
    torch.nn.Parameter,
    float,
    int,
    bool,
    list,
}  # arguments that kernels take
VARIANTS = ["default", "avx2", "avx512"]  # each runs what the ones before it run

_backend: Backend = "auto"
_forked = False  # whether this process is a fork of one that had loaded this
_told: set[str] = set()  # reasons that were told, once each


@dataclass(frozen=True)
class NativeStatus:
    """The status of the compiled extension."""

    loaded: bool
    variant: str | None  # instruction set of the build that is loaded: default, avx2 or avx512
    reason: str | None  # why none is loaded
    built: tuple[str, ...]  # variants that are installed
    usable: tuple[str, ...]  # variants that this processor runs
    embree: int | None  # version of Embree, which traces rays; None: built without, or not loaded


def native_status() -> NativeStatus:
    """The status of the compiled extension: whether it is loaded, and if not, why.

    Without it, ops run in eager PyTorch, and `VisibilityScene` raises.
    """
    version = core.embree_version() if core is not None else 0
    return NativeStatus(
        loaded=core is not None,
        variant=variant if core is not None else None,
        reason=variant if core is None else None,
        built=tuple(sorted(_built(), key=VARIANTS.index)),
        usable=tuple(_usable()),
        embree=version or None,
    )


def _built() -> dict[str, Path]:
    """Files of the extension by variant."""
    found = {p.parent.name: p for p in FOLDER.glob("*/_core.*") if p.suffix in (".so", ".pyd")}
    return {name: path for name, path in found.items() if name in VARIANTS}


def _usable() -> list[str]:
    """Variants that this processor runs, the best last."""
    capability = torch.backends.cpu.get_cpu_capability().lower()
    return VARIANTS[: VARIANTS.index(capability) + 1] if capability in VARIANTS else ["default"]


def _load() -> tuple[ModuleType | None, str]:
    """The build for this processor, or None and the reason why there is none."""
    built, usable = _built(), _usable()
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
    return None, f"no compiled extension in {FOLDER}"


core: ModuleType | None
variant: str
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
            f"the native backend supports float32 and float64 on the cpu, got {tensor.dtype} on "
            f"{tensor.device}"
        )
    if core is None:
        _tell_once(f"the compiled extension is not loaded: {variant}")
    elif not fits:
        _tell_once(
            f"kernels support float32 and float64 on the cpu, got {tensor.dtype} on {tensor.device}"
        )
    return core is not None and fits


def _tell_once(why: str) -> None:
    """Warn that an op runs without its kernel, once for each reason."""
    # A compiled graph would be broken by the logging
    if why not in _told and not torch.compiler.is_compiling():
        _told.add(why)
        log.warning("univoxel.ops uses eager PyTorch, which is many times slower: %s", why)


def reference_asked() -> bool:
    """Whether the reference is forced; for ops too slow in eager torch to fall back unasked."""
    return _backend == "reference"


@contextlib.contextmanager
def use_backend(name: Backend) -> Iterator[None]:
    """Force a backend within a ``with`` block: "native", "reference", or "auto" (the default).

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
        raise MissingNative(
            f"univoxel's compiled extension is not loaded: {variant}; run `univoxel doctor` for "
            "help"
        )
    return core


def require_embree(what: str) -> ModuleType:
    """The extension with rays, or an error that says what is missing and how to get it.

    Args:
        what: needs Embree; the subject of the message.
    """
    found = require()
    if not found.embree_version():
        raise MissingNative(
            f"{what} needs Embree for ray tracing, but univoxel was built without it: install "
            "Embree 3 or 4 (Debian: apt-get install libembree-dev) and rebuild univoxel (pip "
            "install . in its source folder), or install a wheel that includes Embree"
        )
    return found


def call(kernel: str | Callable, *arguments: Any) -> Any:
    """Call a kernel, by name or as it is: with tensors as `arrays`, and the number of threads as
    last argument."""
    called = getattr(require(), kernel) if isinstance(kernel, str) else kernel
    return called(*arrays(*arguments), threads())


def arrays(*arguments: Any) -> list[Any]:
    """NumPy views of tensors, as the extension takes them: halves as their bits. What is no tensor
    stays as it is."""
    # Every call of an op pays for each of these steps
    return [
        t
        if not isinstance(t, Tensor)
        else t.view(torch.uint16).numpy()
        if t.dtype is torch.float16
        else t.detach().numpy()
        if t.requires_grad
        else t.numpy()
        for t in arguments
    ]


def threads() -> int:
    """torch.set_num_threads rules the kernels too; a forked process runs them on one thread."""
    return 1 if _forked else torch.get_num_threads()


def _serial_from_now_on() -> None:
    # GNU's OpenMP waits for ever for a team that was left in the parent. The bits are the same
    global _forked
    _forked = True


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_serial_from_now_on)


class Operator:
    """A kernel as an op of torch, and a short way to it.

    `torch.library` makes it known to compilers and to tensors of other kinds; through it a call
    costs a fifth of a millisecond, as much as the kernels of a small batch. Where none of these is
    there, calls go to the kernel itself, or to an autograd function of it. Kernels that write to
    their arguments, which torch counts, go by the library always.
    """

    def __init__(
        self,
        name: str,
        kernel: Callable,
        schema: str,
        fake: Callable,
        mutates_args: tuple[str, ...] = (),
    ) -> None:
        """
        Args:
            schema: arguments and what is returned, as torch spells them.
            fake: called as the kernel is; returns what comes out, without values.
        """
        qualified = f"univoxel::{name}"
        self.name: str = name
        self.kernel: Callable[..., Any] = kernel
        self.defined: Any = torch.library.custom_op(
            qualified, kernel, mutates_args=mutates_args, device_types=(), schema=schema
        )
        # Kernels that custom_op registers itself import the compiler when first called: a second,
        # and 70 MB, of every command
        torch.library.impl(qualified, "cpu", kernel)
        self.defined.register_fake(fake)
        self._direct: Callable = self.defined if mutates_args else kernel

    def __call__(self, *arguments: Any) -> Any:
        if goes_by_library(arguments):
            return self.defined(*arguments)
        return self._direct(*arguments)


def goes_by_library(arguments: Sequence[Any]) -> bool:
    """Whether something else than plain arguments, computed at once, goes through an op."""
    return (
        torch.compiler.is_compiling()
        or bool(torch._C._len_torch_dispatch_stack())
        or torch._C._are_functorch_transforms_active()
        or not PLAIN.issuperset(map(type, arguments))
    )
