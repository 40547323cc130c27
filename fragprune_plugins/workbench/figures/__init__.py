"""What is known of a model in numbers and pictures, and how pages and sentences show it."""
