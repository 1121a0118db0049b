"""What a fit looks at: training pixels, how many the time allows, and the start that they tell at once."""
