"""Rollouts on a GPU: the closed loop's own kernel as CUDA C++, one motion a thread.

The text is compiled by NVRTC, NVIDIA's run-time compiler (extra ``gpu``).  Where there is no GPU
the host's C++ compiler takes the same text, which is how it is tested.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from shutil import which
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from undertow.base import ArtefactError, MissingExtraError, ResourceError, checked, require_extra
from undertow.closed_loop.kernel import build_loop_graph
from undertow.closed_loop.kernel_source import kernel_source
from undertow.closed_loop.rollout import ClosedLoop
from undertow.closed_loop.threads import BLOCK
from undertow.symbolic.cuda import Translation

#: Parameters of ``rollout`` behind its lanes: numbers, and the axes of arrays.
PARAMETERS: Mapping[str, str] = {
    "x0": "2", "live": "1", "lanes": "3", "switch": "1", "plant": "1", "belief": "1",
    "limits": "1", "noise": "3", "start": "double", "h": "double", "steps": "long long",
    "zoh_steps": "long long", "terminal": "double", "escape": "double", "cap": "double",
    "seek": "double", "prices": "1", "calm_from": "long long", "every": "long long", "record": "3",
    "out": "2",
}  # fmt: skip

#: Arrays that a rollout writes.
WRITTEN = "record", "out"

#: Threads of a GPU's block: few, for each keeps a whole motion in its registers.
THREADS = 128


@checked
def on_gpu(loop: ClosedLoop, compiler: Literal["nvrtc", "host"] = "nvrtc") -> ClosedLoop:
    """Return a closed loop whose batches run on the GPU, in small steps to the end.

    Its batches are those of ``loop`` with ``tail_rtol=0`` up to rounding, about 1e-12 of a state
    after a second of motion.  :meth:`undertow.ClosedLoop.simulate` stays on the processor, and so
    does a copy that is pickled.

    Parameters
    ----------
    loop
        The closed loop; with an ensemble as well.
    compiler
        ``"nvrtc"``: on the GPU.  ``"host"``: by the host's C++ compiler, on the processor, to try
        the text where there is no GPU.

    Raises
    ------
    ArtefactError
        When the text does not compile.
    MissingExtraError
        Without the extra ``gpu``, or without a C++ compiler.
    ResourceError
        When no GPU is found.
    """
    text = CudaText(loop)
    kernel = _Gpu(text) if compiler == "nvrtc" else _Host(text)
    other = loop._changed({"takes_large_steps", "_kernels"}, threads=1, tail_rtol=0.0)
    other.__dict__["_kernels"] = SimpleNamespace(rollout=kernel)
    return other


class CudaText:
    """The kernel of a closed loop as CUDA C++, and how it is called.

    ``text``: the module; its entry is ``rollout_all(count, …)``. ``shapes``: lengths that follow
    the parameters: (array, axis).
    """

    def __init__(self, loop: ClosedLoop) -> None:
        source = kernel_source(build_loop_graph(loop.equations), header="")
        kinds = {"from_lane": "long long", "to_lane": "long long", **PARAMETERS}
        made = Translation(source, "rollout", kinds, BLOCK)
        self.text, self.shapes = made.text, made.shapes

    def arguments(self, values: Sequence[Any]) -> dict[str, Any]:
        """Return what is passed by name: arrays whole and in order, numbers, lengths of axes."""
        named = dict(zip(PARAMETERS, values, strict=True))
        for name, kind in PARAMETERS.items():
            if kind.isdigit():
                named[name] = np.ascontiguousarray(named[name])
        lengths = {f"{name}_{axis}": named[name].shape[axis] for name, axis in self.shapes}
        return named | lengths


class _Host:
    """The text as a library of this machine's own."""

    def __init__(self, text: CudaText) -> None:
        found = which("c++") or which("g++") or which("clang++")
        if found is None:
            raise MissingExtraError(
                "CUDA text on the host", remedy="Install a C++17 compiler: c++, g++ or clang++"
            )
        self._text = text
        with tempfile.TemporaryDirectory() as folder:
            source, library = Path(folder, "rollout.cpp"), Path(folder, "rollout.so")
            source.write_text(text.text, encoding="ascii")
            flags = "-std=c++17", "-O2", "-march=native", "-shared", "-fPIC"
            done = subprocess.run(
                [found, *flags, str(source), "-o", str(library)],
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            _compiled(done.returncode == 0, done.stderr, Path(found).name)
            self._entry = ctypes.CDLL(str(library)).rollout_all
        self._entry.restype = None

    def __call__(self, first: int, last: int, *values: Any) -> None:
        named = self._text.arguments(values)
        self._entry(ctypes.c_longlong(last - first), *map(_c_value, named.values()))
        _give_back(named, values)


class _Gpu:
    """The text on the first GPU."""

    def __init__(self, text: CudaText) -> None:
        require_extra("cuda.core", "gpu", "rollouts on a GPU")
        from cuda.core import Device, Program, ProgramOptions

        try:
            self._device = Device()
            self._device.set_current()
        except Exception as error:  # of the driver, in more than one form
            raise ResourceError(
                "GPU",
                value=str(error)[:200],
                limit="a GPU of NVIDIA's with its driver",
                remedy="Roll out on the processor: ClosedLoop.batch",
            ) from error
        self._text = text
        options = ProgramOptions(std="c++17", arch=f"sm_{self._device.arch}")
        try:
            self._module = Program(text.text, "c++", options).compile("cubin")
        except Exception as error:
            _compiled(False, str(error), "NVRTC")
        self._kernel = self._module.get_kernel("rollout_all")

    @cached_property
    def _stream(self) -> Any:
        return self._device.create_stream()

    def __call__(self, first: int, last: int, *values: Any) -> None:
        from cuda.bindings import driver
        from cuda.core import LaunchConfig, launch

        named, count, stream = self._text.arguments(values), last - first, self._stream
        there = {
            name: self._device.allocate(max(8, array.nbytes), stream=stream)
            for name, array in named.items()
            if isinstance(array, np.ndarray)
        }
        stream.sync()
        for name, buffer in there.items():
            _driver(
                driver.cuMemcpyHtoD(int(buffer.handle), named[name].ctypes.data, named[name].nbytes)
            )
        arguments = [
            there[name] if name in there else _c_value(value) for name, value in named.items()
        ]
        config = LaunchConfig(grid=-(-count // THREADS), block=THREADS)
        launch(stream, config, self._kernel, ctypes.c_longlong(count), *arguments)
        stream.sync()
        for name in WRITTEN:
            array = named[name]
            _driver(driver.cuMemcpyDtoH(array.ctypes.data, int(there[name].handle), array.nbytes))
        for buffer in there.values():
            buffer.close()
        _give_back(named, values)


def _c_value(value: Any) -> Any:
    """Return an argument as C takes it."""
    if isinstance(value, np.ndarray):
        return ctypes.c_void_p(value.ctypes.data)
    return ctypes.c_double(value) if isinstance(value, float) else ctypes.c_longlong(int(value))


def _give_back(named: Mapping[str, Any], values: Sequence[Any]) -> None:
    """Write what was rolled out into arrays that did not lie whole and in order."""
    for name, value in zip(PARAMETERS, values, strict=True):
        if name in WRITTEN and named[name] is not value:
            value[...] = named[name]


def _compiled(well: bool, said: str, compiler: str) -> None:
    if not well:
        first = next((line for line in said.splitlines() if "error" in line), said[-200:])
        raise ArtefactError(
            "kernel in CUDA C++",
            value=first,
            limit=f"accepted by {compiler}",
            remedy="Report it: generated code must compile",
        )


def _driver(answer: tuple[Any, ...]) -> None:
    if int(answer[0]) != 0:
        raise ResourceError(
            "memory of the GPU",
            value=str(answer[0]),
            limit="copies without an error",
            remedy="Use smaller batches",
        )
