# Makes a certificate, valid for a year: sh certificate.sh NAME HOST-OR-ADDRESS
# Writes NAME.pem and NAME.key.pem. The first call also makes the authority, valid for ten years: ca.pem, which all parts
# need, and ca.key.pem, which stays with whoever makes the certificates. Another call for a NAME renews its certificate.
set -eu
umask 077
name=$1 host=$2
case $host in *[!0-9.]*) host=DNS:$host ;; *) host=IP:$host ;; esac
new="openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes"
[ -e ca.pem ] || $new -days 3650 -subj "/CN=fleet" -keyout ca.key.pem -out ca.pem
$new -days 365 -subj "/CN=$name" -CA ca.pem -CAkey ca.key.pem -keyout "$name.key.pem" -out "$name.pem" \
  -addext "subjectAltName=$host" -addext "basicConstraints=critical,CA:FALSE" \
  -addext "extendedKeyUsage=serverAuth,clientAuth"
