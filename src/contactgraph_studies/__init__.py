"""The paper's studies, each as one command."""
