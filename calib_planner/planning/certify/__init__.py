"""Proving bounds: the sensitivity as a polynomial, its Bernstein form, branch and bound."""
