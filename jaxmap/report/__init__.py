"""What people look at after a run: pictures, a 3D view, and one page that holds them all."""
