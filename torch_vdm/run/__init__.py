"""How the model is computed: executors, each of which gives what `Model.difference` gives."""
