"""The SfM profile: unordered view-graphs, every edge of which may be an outlier."""
