"""Three tiers: the plant, its clusters, and the links between them."""
