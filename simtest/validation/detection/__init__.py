"""How well specularities are detected in colour frames: rendered frames, their specular masks, scores."""
