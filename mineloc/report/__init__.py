"""Tables, figures and the accuracy report."""
