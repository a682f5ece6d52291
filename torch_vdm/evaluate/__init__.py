"""Many frames of several tests beside their reference: figures, comparisons, a report."""
