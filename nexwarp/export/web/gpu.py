"""A thin layer over wgpu: a device with its limits, buffers that are checked before they are made, timed passes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nexwarp.errors import MissingError, OutOfMemoryError

if TYPE_CHECKING:
    from wgpu import GPUAdapter, GPUBindGroup, GPUBuffer, GPUComputePipeline

LIMITS = ("max-buffer-size", "max-storage-buffer-binding-size")
MOST_GROUPS = 65535  # workgroups along one dimension of a dispatch


@dataclass(frozen=True)
class Pass:
    """A dispatch.

    Attributes:
        stage: name under which its time is counted.
        pipeline: compute pipeline.
        bindings: bind group.
        groups: workgroups along x and y.
    """

    stage: str
    pipeline: "GPUComputePipeline"
    bindings: "GPUBindGroup"
    groups: tuple[int, int]


def grouped(threads: int, size: int = 256) -> tuple[int, int]:
    """Return workgroups along x and y for a number of threads; shaders compute the index from both."""
    count = max(-(-threads // size), 1)
    rows = -(-count // MOST_GROUPS)
    return -(-count // rows), rows


class Gpu:
    """A device of wgpu.

    Attributes:
        name: of the adapter.
        timed: whether it measures the times of passes.
        half: whether shaders may compute in half precision.
        limits: sizes in bytes that buffers and their bindings may have.
    """

    def __init__(self, adapter: "GPUAdapter | None" = None) -> None:
        """Open a device.

        Args:
            adapter: an adapter of wgpu; None takes the fastest one.

        Raises:
            MissingError: wgpu is not installed, or finds no GPU.
        """
        try:
            import wgpu
        except ImportError:
            raise MissingError('wgpu: expected the package wgpu (pip install "nexwarp[wgpu]"), found none') from None
        self._wgpu = wgpu
        if adapter is None:
            try:
                adapter = wgpu.gpu.request_adapter_sync(power_preference="high-performance")
            except RuntimeError as error:
                raise MissingError(f"wgpu: expected a GPU, found none ({error!s:.200})") from None
        self.timed, self.half = ("timestamp-query" in adapter.features, "shader-f16" in adapter.features)
        wanted = {"timestamp-query": self.timed, "shader-f16": self.half}
        self.device = adapter.request_device_sync(
            required_features=[name for name, there in wanted.items() if there],
            required_limits={name: adapter.limits[name] for name in LIMITS},
        )
        self.name: str = adapter.summary
        self.limits = {name: int(self.device.limits[name]) for name in LIMITS}
        self._pipelines: dict[tuple[str, str], GPUComputePipeline] = {}

    def buffer(self, name: str, content: int | np.ndarray | bytes, uniform: bool = False) -> "GPUBuffer":
        """Make a buffer of a size in bytes, or with contents.

        Raises:
            OutOfMemoryError: the size is beyond the device's limits.
        """
        data = b""
        if not isinstance(content, int):
            data = content if isinstance(content, bytes) else np.ascontiguousarray(content).tobytes()
        size = max(content if isinstance(content, int) else len(data), 16)
        size = -(-size // 16) * 16
        most = min(self.limits.values())
        if size > most:
            raise OutOfMemoryError(
                f"{name}: expected at most {most:,} bytes in a buffer of this device ({self.name}), got {size:,}"
            )
        usage = self._wgpu.BufferUsage
        kind = usage.UNIFORM if uniform else usage.STORAGE | usage.COPY_SRC
        made = self.device.create_buffer(label=name, size=size, usage=kind | usage.COPY_DST)
        if data:
            self.device.queue.write_buffer(made, 0, data + bytes(-len(data) % 4))
        return made

    def pipeline(self, name: str, source: str, entry: str) -> "GPUComputePipeline":
        """Compile an entry point of a shader, once."""
        key = (source, entry)
        if key not in self._pipelines:
            module = self.device.create_shader_module(label=name, code=source)
            compute = {"module": module, "entry_point": entry}
            self._pipelines[key] = self.device.create_compute_pipeline(label=entry, layout="auto", compute=compute)
        return self._pipelines[key]

    def bind(self, pipeline: "GPUComputePipeline", buffers: Mapping[int, "GPUBuffer"]) -> "GPUBindGroup":
        """Bind buffers to a pipeline's bindings."""
        entries = [
            {"binding": index, "resource": {"buffer": buffer, "offset": 0, "size": buffer.size}}
            for index, buffer in buffers.items()
        ]
        return self.device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries)

    def run(self, passes: Sequence[Pass], timed: bool = False) -> dict[str, float]:
        """Submit passes.

        Args:
            passes: the dispatches, in order.
            timed: measure them and wait.

        Returns:
            Milliseconds by stage; empty unless `timed` and the device measures times.
        """
        timed = timed and self.timed
        encoder = self.device.create_command_encoder()
        queries = self.device.create_query_set(type="timestamp", count=2 * len(passes)) if timed else None
        if queries is None:
            compute = encoder.begin_compute_pass()
            for one in passes:
                compute.set_pipeline(one.pipeline)
                compute.set_bind_group(0, one.bindings)
                compute.dispatch_workgroups(*one.groups, 1)
            compute.end()
        else:
            for index, one in enumerate(passes):
                marks = {"beginning_of_pass_write_index": 2 * index, "end_of_pass_write_index": 2 * index + 1}
                compute = encoder.begin_compute_pass(timestamp_writes={"query_set": queries, **marks})
                compute.set_pipeline(one.pipeline)
                compute.set_bind_group(0, one.bindings)
                compute.dispatch_workgroups(*one.groups, 1)
                compute.end()
        resolved = None
        if queries is not None:
            usage = self._wgpu.BufferUsage
            size = 16 * len(passes)
            resolved = self.device.create_buffer(size=size, usage=usage.QUERY_RESOLVE | usage.COPY_SRC)
            encoder.resolve_query_set(queries, 0, 2 * len(passes), resolved, 0)
        self.device.queue.submit([encoder.finish()])
        if resolved is None:
            return {}
        ticks = np.frombuffer(self.device.queue.read_buffer(resolved), np.uint64).reshape(-1, 2)
        times: dict[str, float] = {}
        for one, (start, end) in zip(passes, ticks.tolist(), strict=True):
            times[one.stage] = times.get(one.stage, 0.0) + max(end - start, 0) / 1e6
        return times

    def read(self, buffer: "GPUBuffer", dtype: type, count: int) -> np.ndarray:
        """Wait, and return the first elements of a buffer."""
        size = count * np.dtype(dtype).itemsize
        return np.frombuffer(self.device.queue.read_buffer(buffer, 0, size), dtype).copy()

    def write(self, buffer: "GPUBuffer", data: bytes) -> None:
        """Write to the beginning of a buffer."""
        self.device.queue.write_buffer(buffer, 0, data)
