"""How effects show, as their files say it: columns of the regressions, and of the screening for missing causes."""
