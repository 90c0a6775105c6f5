"""Several assets in one: where each stands, colours matched where they meet, and files that hold all of them."""
