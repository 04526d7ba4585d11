"""The plant, written down once: parameters, balances, effects, and what is compiled from them."""
