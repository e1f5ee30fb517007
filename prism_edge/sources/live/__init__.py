"""Live cameras: each kind is a driver; one class turns any of them into a source (docs/CAMERAS.md)."""
