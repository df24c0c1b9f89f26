"""The tunnel: centrelines, sections and roughness, meshed into one closed surface; or a mesh made by others."""
