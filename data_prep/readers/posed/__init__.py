"""Source for the user's own data: posed pictures with tracked masks (docs/posed_data.md)."""
