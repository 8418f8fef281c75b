"""Flow fields: formulas, files, strokes and fluids; inversion and warps; pictures of flows."""
