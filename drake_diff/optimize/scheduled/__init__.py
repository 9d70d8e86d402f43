"""First guesses of a robot's motion where it is known which foot stands when."""
