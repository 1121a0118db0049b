"""How light falls on a surface and what the surface makes of it: shading, guides, bounced light."""
