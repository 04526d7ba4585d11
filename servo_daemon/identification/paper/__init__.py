"""The paper's methods side by side on one capture, and its own numbers redone."""
