"""Pictures of textured things, drawn in software."""
