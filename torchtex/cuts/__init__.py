"""Discrete stages: min-cut, seams, expansion moves; and the gradient-domain fusion after them."""
