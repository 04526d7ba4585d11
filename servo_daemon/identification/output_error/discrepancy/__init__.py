"""What a fit leaves unexplained, in its standard deviations: laws, lags, rows and filters that explain as much."""
