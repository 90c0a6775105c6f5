"""What a painter works with and works by: edited pictures, assets, settings, one class per method, the receipt."""
