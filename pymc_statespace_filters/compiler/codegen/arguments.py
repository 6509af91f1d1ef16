"""Arguments of the functions of a system that have a symbol, as entry points have them."""

from numba import types

from ..native.entry_point import F64_PTR, I64_PTR, arguments_class

PARAMETER_ARGUMENTS = {"theta": F64_PTR, "n_theta": types.intp, "out": F64_PTR}
"""Of a function of parameters."""

MEMBER_ARGUMENTS = {
    "c": F64_PTR, "inputs": F64_PTR, "k": types.intp, "t": types.float64, "z": F64_PTR,
    "width": types.intp, "X": F64_PTR, "out": F64_PTR, "n_members": types.intp,
}  # fmt: skip
"""Of a function of all members. ``z`` holds normals in rows of ``width``, or one vector for all
members: an observation or noise. ``out`` may hold gains, which are read."""

FOLLOW_ARGUMENTS = {
    "c": F64_PTR, "inputs": F64_PTR, "first": types.intp, "last": types.intp, "t0": types.float64,
    "dt": types.float64, "path": F64_PTR, "gains": F64_PTR, "steps": F64_PTR, "cov": F64_PTR,
}  # fmt: skip
"""Of a guide that follows a path from step ``first`` to ``last``, see `lowering.guide_loops`."""

LOOK_BACK_ARGUMENTS = {
    "first": types.intp, "last": types.intp, "path": F64_PTR, "steps": F64_PTR, "gains": F64_PTR,
    "psi": F64_PTR, "sums": F64_PTR,
}  # fmt: skip
"""Of a guide that goes back."""

LANES = 32  # at most
LANES_AT_ONCE = 8  # the number of lanes is a multiple of this
LANE_ARGUMENTS = {
    "W": F64_PTR, "n_lanes": types.intp, "states": F64_PTR, "forces": F64_PTR, "t0": types.float64,
    "dt": types.float64, "k": types.intp, "n_steps": types.intp,
}  # fmt: skip
"""Of a function of the steps k to k + n_steps - 1, whose states and inputs come first."""

ALONG_ARGUMENTS = {
    "W": F64_PTR, "steps": I64_PTR, "row_width": types.intp, "n_rows": types.intp,
    "first": types.intp, "observed": F64_PTR, "inputs": F64_PTR, "noises": F64_PTR,
    "states": F64_PTR, "stride": types.intp, "t0": types.float64, "dt": types.float64,
    "terms": F64_PTR,
}  # fmt: skip
"""Of a loop along a record. The step of row j is ``steps[j * row_width]``, and ``first`` that of
the state at the start of a forward pass; a way back ends at step 0. Successive states are
``stride`` numbers apart on the tape ``states``, or on one place if this is 0."""

MemberArguments = arguments_class("MemberArguments", MEMBER_ARGUMENTS, __name__)
FollowArguments = arguments_class("FollowArguments", FOLLOW_ARGUMENTS, __name__)
LookBackArguments = arguments_class("LookBackArguments", LOOK_BACK_ARGUMENTS, __name__)
LaneArguments = arguments_class("LaneArguments", LANE_ARGUMENTS, __name__)
AlongArguments = arguments_class("AlongArguments", ALONG_ARGUMENTS, __name__)
