"""Volume meshes that other programs wrote, as their files hold them."""
