"""Links between the plant and its clusters: messages, envelopes, connections and their carriers."""
