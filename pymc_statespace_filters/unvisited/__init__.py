"""Whether chains have left parts of the posterior unvisited: a check by importance sampling."""
