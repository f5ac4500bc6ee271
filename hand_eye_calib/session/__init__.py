"""What a person does with results: reach a goal, compare with what is installed."""
