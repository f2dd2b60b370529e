"""The user's own data: posed pictures with tracked instance masks (docs/posed_data.md)."""
