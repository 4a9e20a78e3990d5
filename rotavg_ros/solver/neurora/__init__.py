"""NeuRoRA as the paper has it: message passing, CleanNet, the tree, FineNet. ``tiled`` runs the same formulas fast."""
