"""The yard over time: surveys, bundles that keep their names, lifts, alarms, an audit log; one database."""
