"""The past as the API gives it: history and events, as JSON, CSV and Parquet."""
