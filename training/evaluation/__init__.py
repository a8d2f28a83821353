"""Models judged on data and laws that they have not seen."""
