"""The log-likelihood of a record as PyTensor operations: its value, and its derivative.

PyTensor imports its own conversions to JAX when that is asked for and offers no such moment to
others. But each graph goes through the rewrites called "jax" before it is converted. The one below
changes nothing: it imports the conversions, and JAX with them, which is then needed anyway.
"""

from pytensor.compile.mode import optdb
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.rewriting.basic import graph_rewriter


@graph_rewriter
def import_jax_conversions(fgraph: FunctionGraph) -> None:
    """Import the module that registers how operations are converted to JAX."""
    from . import jax as jax


optdb.register("statespace_import_jax_conversions", import_jax_conversions, "jax", position=0)
