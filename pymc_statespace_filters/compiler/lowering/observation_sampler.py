"""Drawing one observation of one state from the user's distributions."""

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph

from ...system.model import StateSpaceModel
from ..codegen.array_fallback import array_code
from ..codegen.function_types import CompiledFunction, jit
from ..native.cache_key import key_of
from ..native.jit import copy_into
from .symbols import SYMBOLS, symbols_of


def distribution_sampler(system: StateSpaceModel, graph: FrozenFunctionGraph) -> CompiledFunction:
    """``observe(rng, functions, c, inputs, k, t, x, out)`` writes a draw of d given x (n, 1).

    It is that of the user's distributions by PyTensor's code, to out (p,). ``functions`` are not
    used.
    """
    no_noise = {"q": pt.zeros((system.m,)), "e": pt.zeros((system.r,))}
    symbols = symbols_of(system) | no_noise
    core = [symbols[name] for name in SYMBOLS]
    generators = [variable.type() for variable in graph.inputs[len(core) :]]
    (draw,) = graph.bind([*core, *generators])
    # A mutable generator is advanced in place; a copy would give the same draw every time.
    mutable = [pytensor.In(generator, mutable=True) for generator in generators]
    named = [symbols[name] for name in ("theta", "x", "u", "t")]
    code = array_code([*named, *mutable], [draw])
    draw_code, n_theta, n_inputs = code.function, system.n_theta, system.n_inputs
    no_inputs = np.zeros(0)
    copies = "rng, " * len(generators)
    source = (
        "def observe(rng, functions, c, inputs, k, t, x, out):\n"
        f"    u = {'inputs[k]' if n_inputs else 'no_inputs'}\n"
        "    (drawn,) = draw_code(c[:n_theta].copy(), x[:, 0].copy(), u, np.asarray(t), "
        f"{copies})\n"
        "    copy_into(out, drawn)\n"
    )
    namespace = {
        "np": np,
        "copy_into": copy_into,
        "draw_code": draw_code,
        "n_theta": n_theta,
        "no_inputs": no_inputs,
    }
    exec(compile(source, "<observe of a state-space system>", "exec"), namespace)
    return CompiledFunction(
        jit(namespace["observe"]), key_of(__name__, source + repr(n_theta), code.key)
    )
