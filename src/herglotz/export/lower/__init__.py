"""From a traced function to one format each: tables of operations."""
