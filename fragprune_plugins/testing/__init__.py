"""What proves an engine or an adapter: seeded scenes and the conformance kit."""
