"""From the first samples to a filter that runs."""
