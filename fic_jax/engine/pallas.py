"""The backend `pallas`: one GPU kernel for all scenarios, where `ptx` can't run.

On a GPU `lax.scan` launches several kernels for each plant step (jax#2491). Here one kernel's grid
runs over blocks of scenarios, one scenario a thread. Both backends trace the same function.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

WARP = 32  # threads that execute together


def in_one_kernel(
    run: Callable[[list[jax.Array], jax.Array], Any], result: Any, *, lanes: int, interpret: bool
) -> Callable[[jax.Array, jax.Array, jax.Array], Any]:
    """`run` over many blocks: columns [field, block, lane], dt, blocks -> leaves [block, lane].

    `run` takes a list of [lane] columns and dt to a pytree of [lane] arrays with the types of
    `result`; blocks beyond the first `blocks` are not computed. With `interpret`
    XLA computes the kernel, on any device.
    """
    leaves, tree = jax.tree.flatten(result)

    def body(dt: Any, blocks: Any, *refs: Any) -> None:
        columns, outs = refs[: len(refs) - len(leaves)], refs[len(refs) - len(leaves) :]

        @pl.when(pl.program_id(0) < blocks[0])
        def _() -> None:
            results = run([column[...] for column in columns], dt[0])
            for out, leaf in zip(outs, jax.tree.leaves(results), strict=True):
                out[...] = leaf.astype(out.dtype)

    def launch(columns: jax.Array, dt: jax.Array, blocks: jax.Array) -> Any:
        n_fields, n_blocks, _ = columns.shape
        one, block = pl.BlockSpec((1,), lambda i: (0,)), pl.BlockSpec((lanes,), lambda i: (i,))
        flat = pl.pallas_call(
            body,
            out_shape=[jax.ShapeDtypeStruct((n_blocks * lanes,), _stored(leaf)) for leaf in leaves],
            grid=(n_blocks,),
            in_specs=[one, one, *n_fields * [block]],
            out_specs=len(leaves) * [block],
            compiler_params=triton.CompilerParams(num_warps=lanes // WARP, num_stages=1),
            interpret=interpret,
            name="fic_sweep",
        )(dt[None], blocks[None], *columns.reshape(n_fields, -1))
        shaped = [
            f.reshape(n_blocks, lanes).astype(t.dtype) for f, t in zip(flat, leaves, strict=True)
        ]
        return jax.tree.unflatten(tree, shaped)

    return launch


def _stored(leaf: Any) -> Any:
    """The type of a leaf in memory: Triton stores no single bits."""
    return jnp.dtype(jnp.int8) if leaf.dtype == jnp.dtype(bool) else leaf.dtype
