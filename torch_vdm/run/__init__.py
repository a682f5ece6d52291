"""How the model is computed: executors that all give what `Model.difference` gives."""
