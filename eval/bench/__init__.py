"""The speed table: each figure beside a rival of the same run."""
