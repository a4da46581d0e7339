"""How sensors ask for geometry: contact pairs, solids, distance fields and surface points."""
