"""Facts in words: what a calculation has found, what it means for this system, and what helps.

Nothing imports this room: `facts` loads it with the first fact. Each module has the words for some
kinds of facts and registers them.
"""

from . import choice as choice
from . import ended_dram as ended_dram
from . import ended_nuts as ended_nuts
from . import filter_check as filter_check
from . import health as health
from . import missed as missed
from . import mobility as mobility
from . import modes as modes
from . import noise as noise
from . import raced as raced
from . import refusals as refusals
from .words import sentences, tell

__all__ = ["sentences", "tell"]
