"""What the images say of the deformed model: driver modes, targets, surface misfit."""
