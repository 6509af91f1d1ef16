"""Whether chains or particles have left parts of the posterior unvisited: importance sampling."""
