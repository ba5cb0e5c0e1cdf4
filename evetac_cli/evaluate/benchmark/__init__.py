"""evaluate benchmark: score methods on evetac-bench; one module each for data set, truth, predictions and scores."""
