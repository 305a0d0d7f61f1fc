"""What flights show: the search for effects, the errors of each episode's own, and forms that a force may have."""
