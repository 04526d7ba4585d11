"""Bounded Gauss–Newton least squares, robust where asked."""
