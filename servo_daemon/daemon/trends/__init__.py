"""Trends from the history: found every hour, and told where a limit is near."""
