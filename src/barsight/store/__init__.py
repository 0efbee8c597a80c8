"""Keep the yard over time in one database: surveys, bundles with lasting names, lifts, alarms, audit log."""
