"""Copy a model with its later observations set to missing."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.model.fgraph import fgraph_from_model, model_from_fgraph


def observed_values(model: pm.Model, name: str) -> NDArray[np.float64]:
    """The observations (J, p) of a StateSpace variable."""
    return np.asarray(model.rvs_to_values[model[name]].eval(mode="FAST_COMPILE"), np.float64)


def truncate_data(model: pm.Model, name: str, n_rows: int) -> pm.Model:
    """Copy a model, keeping only the first `n_rows` observations of a StateSpace variable.

    The later rows are set to missing, so that dimensions, coordinates and noise seeds stay, and an
    estimate uses the same noise as one from all observations at the same seed.
    """
    observed = observed_values(model, name)
    observed[n_rows:] = np.nan
    graph, copies = fgraph_from_model(model)
    node = copies[model[name]].owner
    _, old = node.inputs
    new = old.type.filter_variable(pt.as_tensor(observed))
    graph.change_node_input(node, 1, new, import_missing=True)
    return model_from_fgraph(graph, mutate_fgraph=True)
