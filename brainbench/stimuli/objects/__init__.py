"""What whiskers meet: primitives, procedural families, mesh files and collections of them."""
