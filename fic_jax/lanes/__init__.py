"""A compiler that maps scalar JAX functions over columns, on a CPU's vector registers or on GPUs.

XLA:CPU runs a loop over time as some forty loops over a block of scenarios, through the cache. This
compiler keeps the state of each scenario in registers from the first iteration to the last, one
scenario a vector lane, and shares the columns among the cores. On an NVIDIA GPU a thread has one
scenario.

    lane_map(function)(columns, ...)    the public function (mapping.py)
    where_rare(condition, f, other)     a `jnp.where` whose first arm may be skipped (hints.py)
    Untranslatable                      the function uses an operation that is not supported

Each step of the compiler is one file; kernel.py calls them in this order:

    trace.py          JAX traces the function to a jaxpr; calls are inlined into a graph
    graph.py          the graph: scalar operations, loops, branches; equal operations are one node
    commoning.py      pass: predictive commoning, an iteration reuses values of the last one
    fma.py            pass: FMA contraction, a product and the sum that uses it are rounded once
    branches.py       pass: coherent branches, a vector skips the rare arm of a `where_rare` if no
                      lane needs it
    emit.py           LLVM IR of the graph's nodes, loops and branches
    instructions.py   LLVM IR of one operation: masks, comparisons, conversions, exp
    vectors.py        the function around them, for a CPU
    threads.py        the kernel around them, for a GPU, and its PTX
    objects.py        LLVM compiles for this processor
    gpu.py            cuda.core loads PTX and launches it; copies
    cache.py          the compile cache (sources.py)

Bits depend on the function, its arguments and whether the processor has fused multiply-adds, as all
GPUs have. They do not depend on the width of the registers, on neighbours, on threads or on
branches.

The package imports jax, numpy and, late, llvmlite and cuda.core; nothing else of fic_jax.
"""

from fic_jax.lanes.graph import Untranslatable
from fic_jax.lanes.hints import where_rare
from fic_jax.lanes.mapping import cores, lane_map

__all__ = ["Untranslatable", "cores", "lane_map", "where_rare"]
