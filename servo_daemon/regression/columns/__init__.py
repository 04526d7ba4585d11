"""What effects add to the regressions: columns by hand, and those that their terms say."""
