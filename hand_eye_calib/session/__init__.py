"""What a person does with results: reach a goal, join recordings and sensors, compare."""
