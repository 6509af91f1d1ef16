"""How tests evaluate graphs whose compilation is not their subject."""

from pytensor.compile.mode import Mode

# In Python, as the graph stands: rewriting it, as FAST_COMPILE does, takes ten times as long as
# evaluating it once.
AS_IT_STANDS = Mode(linker="py", optimizer=None)
