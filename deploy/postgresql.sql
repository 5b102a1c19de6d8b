-- A database for the store: sudo -u postgres psql -v ON_ERROR_STOP=1 -f postgresql.sql
-- Its owner is the role of the same name as the system's user, who needs no password here.
CREATE ROLE heliotrope LOGIN;
CREATE DATABASE heliotrope OWNER heliotrope ENCODING 'UTF8' TEMPLATE template0;
REVOKE ALL ON DATABASE heliotrope FROM PUBLIC;
