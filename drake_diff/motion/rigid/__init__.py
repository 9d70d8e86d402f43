"""The motion of a model whose contacts are hard: free or held between impacts, which restitution and friction rule."""
