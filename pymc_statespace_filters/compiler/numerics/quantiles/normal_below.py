"""A standard normal below a limit: its probability, and the moments of what is left.

All follow from the mean distance below the limit, E(z) = z + φ(z) / Φ(z), which is the mean of
z - Z given Z < z, and from the variance V(z) of Z given Z < z. For z <= 0 they are interpolated as
(1 + x) E(-x) and (1 + x)**2 V(-x), which are near one for all x >= 0, so that no digits are lost
however far the limit is; above zero no differences cancel. Φ(z) = φ(z) / (E(z) - z) has no
exponential where its logarithm is taken. Relative errors found from -1e8 to 38 are below 2e-15.
"""

from ...native.jit import inlined
from ..exponential import exp, log, log1p
from ..intrinsics import fma, polynomial

_FARTHEST = 1e100
_ROOT_TWO_PI, _LOG_ROOT_TWO_PI = 2.5066282746310002, 0.9189385332046728

# Chebyshev interpolants in t = (x - 4) / (x + 4), computed with 80 digits.
_EXCESS = (
    6.506735139487786e-09, 1.698305015683087e-09, -7.036600499390639e-08, 9.891843154641498e-09,
    3.9092359936618567e-07, -2.7929054520015153e-07, -1.5175782382554816e-06,
    2.3310414860421705e-06, 4.571418677630219e-06, -1.279242295862494e-05,
    -1.0256678150071215e-05, 5.532513419793487e-05, 9.202628913895238e-06,
    -0.00020243786497594704, 6.874450378806255e-05, 0.0006390045057596706,
    -0.0005603845255541623, -0.0016937145418632258, 0.0027520374543344803,
    0.0032926607008123714, -0.010605538986473222, -0.0011290861298264801, 0.03242420504653714,
    -0.030769392021608697, -0.06107108420325223, 0.19293246887907772, -0.19210374819083545,
    -0.062056379981136396, 1.1280357224473554,
)  # fmt: skip
_VARIANCE = (
    6.932210174844425e-08, 8.391599251898785e-08, -7.983673975605691e-07, -5.64168905545358e-07,
    4.785234267177165e-06, 4.803197852247319e-07, -2.0395701217676793e-05,
    1.1954527718200367e-05, 6.991577523539107e-05, -9.36621197349447e-05,
    -0.00020013183928013542, 0.0004476711986139027, 0.00046120290096214264,
    -0.0016802324121800085, -0.0006927686444893616, 0.005322233927217594,
    -0.00040745082934589785, -0.014419989390940476, 0.008171588936099651, 0.03238914226050833,
    -0.03831570283310672, -0.053301683741097325, 0.12287716933744965, 0.028307654339082926,
    -0.2824285272728699, 0.19106120915206445, 0.34623171990325735, -0.6731751439274811,
    0.16255921026212483, 1.1668209599355657,
)  # fmt: skip


@inlined
def _magnitude(z):
    """|z|, at most 1e100; NaN stays NaN."""
    x = abs(z)
    return _FARTHEST if x > _FARTHEST else x


@inlined
def _excess_below(x):
    """E(-x) for x >= 0."""
    return polynomial((x - 4.0) / (x + 4.0), _EXCESS) / (1.0 + x)


@inlined
def _density(x):
    """φ(x)."""
    square = x * x
    lost = fma(x, x, -square)
    return exp(-0.5 * square) * (1.0 - 0.5 * lost) / _ROOT_TWO_PI


@inlined
def _hazard_above(x):
    """φ(x) / Φ(x) for x >= 0."""
    density = _density(x)
    return density / (1.0 - density / (x + _excess_below(x)))


@inlined
def normal_log_probability(z):
    """log Φ(z)."""
    x = _magnitude(z)
    hazard = x + _excess_below(x)
    below = -0.5 * z * z - (log(hazard) + _LOG_ROOT_TWO_PI)
    return below if z <= 0.0 else log1p(-_density(x) / hazard)


@inlined
def normal_hazard(z):
    """φ(z) / Φ(z)."""
    x = _magnitude(z)
    return x + _excess_below(x) if z <= 0.0 else _hazard_above(x)


@inlined
def normal_excess(z):
    """z + φ(z) / Φ(z), the mean of z - Z given Z < z."""
    x = _magnitude(z)
    return _excess_below(x) if z <= 0.0 else x + _hazard_above(x)


@inlined
def normal_variance_below(z):
    """The variance of Z given Z < z."""
    x = _magnitude(z)
    one = 1.0 + x
    below = polynomial((x - 4.0) / (x + 4.0), _VARIANCE) / (one * one)
    hazard = _hazard_above(x)
    return below if z <= 0.0 else 1.0 - hazard * (x + hazard)
