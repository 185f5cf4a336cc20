"""The layered body in two dimensions: finite elements in plane strain under the section of a head."""
