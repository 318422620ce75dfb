"""The AR system (thesis, chapter 4): from a depth camera's recording to the mesh over the image."""
