"""Makes the conversions of `ops.jax` known whenever PyTensor compiles a graph with JAX.

PyTensor imports its own conversions when JAX is asked for and offers no such moment to others. But
each graph goes through the rewrites called "jax" before it is converted. This one changes nothing:
it imports the conversions, and JAX with them, which is then needed anyway.
"""

from pytensor.compile.mode import optdb
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.rewriting.basic import graph_rewriter


@graph_rewriter
def import_conversions(fgraph: FunctionGraph) -> None:
    """Import the module that registers how operations are converted to JAX."""
    from . import jax as jax


optdb.register("statespace_import_jax_conversions", import_conversions, "jax", position=0)
