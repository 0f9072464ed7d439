"""The nodes, one file each: planner, identifier, campaign and the simulated tracker."""
