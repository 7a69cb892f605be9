"""What the sweep engine is measured against."""
