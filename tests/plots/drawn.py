"""What the backend "none" notes down instead of drawing it."""


def drawn(collection, visual, variable=None):
    """Return the arguments of a visual by model or estimator; None where nothing was drawn."""
    found = collection.viz[visual]
    things = found[variable or next(iter(found.data_vars))]
    (dim,) = things.dims
    return {str(thing[dim].item()): thing.item() for thing in things}
