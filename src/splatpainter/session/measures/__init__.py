"""What can be measured of an asset: which way is up, its plane of symmetry, how its surface bends."""
