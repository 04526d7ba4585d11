"""A filter that started wrong or has diverged, and how it begins again."""
