"""The backends `xla` and `pallas`: one program of one fixed block shape, run as often as N needs.

XLA may round differently in programs of different shapes; one shape makes a scenario's bits
independent of N, of its neighbours and of the number of calls.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from fic_jax.inputs import on_host, transferred

# Scenarios that advance together. Their state has to stay in the L1 cache and fill whole vectors;
# 64 to 256 were within 10 % of each other, 512 slower.
LANES = 128
# Blocks that one call holds for each device: some tenths of a second of work at 1,000 steps.
BLOCKS = {"xla": 128, "pallas": 8192, "interpreted": 4}


@dataclass(frozen=True)
class InBlocks:
    """The compiled program of one block shape, called as often as N needs."""

    run: Any  # columns, dt, blocks -> results
    result: Any  # structure and types of one scenario's results
    sharding: NamedSharding  # of the columns
    n_devices: int
    blocks: int  # for each device, in one call

    def __call__(self, leaves: Sequence[np.ndarray], dt: np.ndarray) -> Any:
        """Results with leaves [N] of scenarios with quantities `leaves`, [N] each."""
        out = jax.tree.map(lambda leaf: np.empty(len(leaves[0]), leaf.dtype), self.result)
        n, capacity = len(leaves[0]), self.n_devices * self.blocks * LANES
        for start in range(0, n, capacity):
            part = slice(start, min(start + capacity, n))
            columns, blocks = self._pack([leaf[part] for leaf in leaves])
            computed = on_host(
                transferred(self.run, jax.device_put(columns, self.sharding), dt, blocks)
            )
            for source, values in zip(jax.tree.leaves(computed), jax.tree.leaves(out), strict=True):
                flat = source[:, :blocks].reshape(-1)
                values[part] = flat[: part.stop - part.start]
        return out

    def _pack(self, leaves: Sequence[np.ndarray]) -> tuple[np.ndarray, np.int32]:
        """Columns [field, device, block, lane], and the number of blocks that each device runs.

        Devices get equal shares; lanes beyond N repeat the last scenario.
        """
        n = len(leaves[0])
        blocks = -(-n // (LANES * self.n_devices))
        shape = (len(leaves), self.n_devices, self.blocks, LANES)
        columns = np.empty(shape, leaves[0].dtype)
        lanes = np.empty(self.n_devices * blocks * LANES, leaves[0].dtype)
        for column, leaf in zip(columns, leaves, strict=True):
            lanes[:n] = leaf
            lanes[n:] = leaf[-1]
            column[:, :blocks] = lanes.reshape(self.n_devices, blocks, LANES)
            column[:, blocks:] = leaf[0]
        return columns, np.int32(blocks)


def in_blocks(
    backend: str,
    scenario: Callable[..., Any],
    n_columns: int,
    result: Any,
    dtype: np.dtype,
    devices: Sequence[jax.Device],
) -> InBlocks:
    """One program for all devices that computes `scenario(column, dt)` for [device, block, lane].

    The number of blocks is a value, not a shape: the last call runs the same code on fewer blocks.
    `backend` is xla, pallas, or interpreted: Pallas' kernel without a GPU.
    """
    if backend == "xla":
        of_device = _one_after_another(jax.vmap(scenario, in_axes=(1, None)), result)
    else:
        from fic_jax.engine.pallas import in_one_kernel  # Pallas imports slowly

        of_device = in_one_kernel(scenario, result, lanes=LANES, interpret=backend == "interpreted")

    def on_device(columns: jax.Array, dt: jax.Array, blocks: jax.Array) -> Any:
        return jax.tree.map(lambda o: o[None], of_device(columns[:, 0], dt, blocks))

    mesh = Mesh(np.array(devices), ("device",))
    spec = P(None, "device")
    shares = jax.jit(
        jax.shard_map(
            on_device,
            mesh=mesh,
            in_specs=(spec, P(), P()),
            out_specs=P("device"),
            check_vma=False,
        )
    )
    sharding, blocks = NamedSharding(mesh, spec), BLOCKS[backend]
    if backend != "pallas":
        return InBlocks(shares, result, sharding, len(devices), blocks)
    shape = (n_columns, len(devices), blocks, LANES)
    columns = jax.ShapeDtypeStruct(shape, dtype, sharding=sharding)
    with warnings.catch_warnings():
        # jax 0.11 deprecates Triton; its successor, Mosaic, needs a Hopper GPU
        warnings.filterwarnings("ignore", "The Pallas Triton backend", DeprecationWarning)
        run = shares.lower(columns, np.zeros((), dtype), np.int32(0)).compile()
    return InBlocks(run, result, sharding, len(devices), blocks)


def _one_after_another(block: Any, result: Any) -> Any:
    """Block after block, each with its whole time loop: a block fits into a CPU's L1 cache."""

    def of_device(columns: jax.Array, dt: jax.Array, blocks: jax.Array) -> Any:
        def body(i: jax.Array, out: Any) -> Any:
            return jax.tree.map(lambda o, m: o.at[i].set(m), out, block(columns[:, i], dt))

        shape = columns.shape[1:]
        out = jax.tree.map(lambda leaf: jnp.zeros(shape, leaf.dtype), result)
        return jax.lax.fori_loop(0, blocks, body, out)

    return of_device
